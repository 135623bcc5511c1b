"""What containers carry beside the pictures: where, by which lens and how they were taken."""
