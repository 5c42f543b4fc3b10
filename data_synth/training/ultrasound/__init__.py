"""Training of the network that finds blood in ultrasound."""
