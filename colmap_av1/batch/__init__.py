"""One task on many videos: on this machine, on a cluster, or as parts of an array of jobs."""
