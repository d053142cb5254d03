"""The rows of a study run: by which workers, and where their results are kept."""
