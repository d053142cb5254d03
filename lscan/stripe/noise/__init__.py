"""The noise of a picture, and the bound it sets on every extractor."""
