"""Files, processes, progress and signals: nothing of the subject."""
