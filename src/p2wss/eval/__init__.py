"""Stage 8, eval: Tables 1 and 2 of the paper and the report.

predict, baselines: reconstructions by every method (schema ``RECONSTRUCTIONS``). measure: one row per building and
method (schema ``MEASURES``). tables, report: ``report.html`` and its tables as CSV and LaTeX.
"""
