"""The video file: container, decoding, display geometry, conversion to AV1, metadata."""
