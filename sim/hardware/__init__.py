"""The figures of ``make hardware``: drivers, faults, resuming and the live page, emulated."""
