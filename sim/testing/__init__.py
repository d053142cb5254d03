"""The laboratory of faults: faulty devices and disks, wrong rig files, a browser."""
