"""Bring tracked ultrasound to the MR: in space (patient to MR) and in time (ECG)."""
