"""Faulty devices and disks, wrong rig files and a browser, for the validation and the tests."""
