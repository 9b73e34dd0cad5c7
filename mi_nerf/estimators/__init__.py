"""The same integral by other means: a reference, and without bias."""
