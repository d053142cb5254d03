"""Light of the first order from few rays: many samples only in pixels where it is not even."""
