"""Where a camera behind a flat port or a dome sees a point of the water."""
