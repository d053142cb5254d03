"""The tank as hardware: a webcam over HTTP and a Grbl track on a pseudo-terminal."""
