"""What the commands do, one task a file."""
