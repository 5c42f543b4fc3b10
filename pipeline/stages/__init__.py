"""One file a stage: read the products before it, call the algorithms, write its own product.

Each has ``run(job) -> figures``; the figures go into ``run.json`` and the report.
"""
