"""What readers read of files, and how they say what is wrong with them."""
