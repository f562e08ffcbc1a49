"""Reading and writing of files, and limits on the size of input files."""
