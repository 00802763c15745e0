"""What the demos are made of: a camera's filter, its ground truth, its errors."""
