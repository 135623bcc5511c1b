"""What moves by itself: tracks that contradict the camera, and the regions they make up."""
