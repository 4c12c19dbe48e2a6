"""Stage 8, eval: Tables 1 and 2 of the paper and the report.

predict, baselines -> reconstructions (``io.RECONSTRUCTIONS``); measure -> one row per building and method
(``io.MEASURES``); tables and report -> ``table1.csv``, ``table2.csv``, ``report.html``.
"""
