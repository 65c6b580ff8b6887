"""Tasks to learn by control: a cloth that is thrown into a box."""
