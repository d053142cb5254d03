"""The stripe extractors: one method a module."""
