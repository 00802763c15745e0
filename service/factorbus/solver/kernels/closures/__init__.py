"""Loop closures in the plane that are tested when they come."""
