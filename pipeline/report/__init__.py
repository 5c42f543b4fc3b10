"""The page that shows what happened, and its pictures."""
