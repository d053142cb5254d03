"""The tank in software: Mitsuba 3 renders what the scanner's webcam would see."""
