"""What `factorbus doctor` looks at."""
