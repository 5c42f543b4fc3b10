"""A beating-heart phantom."""
