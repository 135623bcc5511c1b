"""One task on many videos: on this machine, on a Ray cluster, or as shards of a job array."""
