"""The live page: what the camera sees now, measured, and the buttons of a scan."""
