"""Helpers for files, processes, progress and signals, independent of video and geometry."""
