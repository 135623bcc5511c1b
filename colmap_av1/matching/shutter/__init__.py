"""The read-out time of a rolling shutter, from tracks."""
