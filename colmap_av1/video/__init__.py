"""The video file: container, pictures, how players show it, conversion to AV1."""
