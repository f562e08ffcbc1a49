"""Arms whose joints follow from a palm pose in closed form, recognised from their axes."""
