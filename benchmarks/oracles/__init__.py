"""Every way on every problem with a known answer, and their calibration."""
