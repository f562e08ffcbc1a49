"""Import of robots from URDF and MJCF files; information that files lack is guessed and marked."""
