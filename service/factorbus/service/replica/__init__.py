"""A service that follows another one, goes on alone when the link is down, and what the other one does for it."""
