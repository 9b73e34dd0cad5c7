"""Files that hold fields: this program's and those of others."""
