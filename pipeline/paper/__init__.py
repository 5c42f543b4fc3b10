"""The paper's own experiments, repeated from a baked field: figures, table and one page."""
