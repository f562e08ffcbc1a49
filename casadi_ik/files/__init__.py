"""Reading and writing of files, and limits on what is read."""
