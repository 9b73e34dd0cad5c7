"""Position and direction become density and colour."""
