"""What is known of each building, and the files it is written to."""
