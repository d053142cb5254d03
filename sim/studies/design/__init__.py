"""Which rig: a catalogue of parts, a search over them, and the error a rig is predicted to have."""
