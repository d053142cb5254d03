"""The plane maps: one model a module, each from image to the plane of the sheet."""
