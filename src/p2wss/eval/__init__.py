"""Stage 8, eval: Tables 1 and 2 of the paper and the report.

methods: reconstructions (schema ``RECONSTRUCTIONS``). measure: one row per building and method (schema ``MEASURES``).
tables, report: ``report.html`` and its tables as CSV and LaTeX. files: the same measures of any CityJSON file.
"""
