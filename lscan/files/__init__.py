"""Files as bytes: atomic writing, pictures, and their headers read before decoding."""
