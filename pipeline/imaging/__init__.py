"""Read cine MR, ECG and tracked ultrasound; segment the heart."""
