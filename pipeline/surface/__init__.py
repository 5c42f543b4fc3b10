"""From labels to closed surfaces whose vertices correspond through the beat."""
