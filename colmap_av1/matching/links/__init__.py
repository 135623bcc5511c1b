"""SIFT links: matches of SIFT features between images that motion does not connect."""
