"""Parts of the study of how long a drag takes in the browser."""
