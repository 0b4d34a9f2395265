"""Flying a real vehicle: the failsafe around the pilot, its loop, and the links to vehicles."""
