"""What pytest offers once lscan is installed: fixtures of suites, and tests against a baseline."""
