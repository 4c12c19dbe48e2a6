"""What a config will cost before anything runs: tiles, jobs, buildings, hours, disk and memory.

:mod:`p2wss.plan.work` counts the work, :mod:`p2wss.plan.costs` multiplies it by measured costs per unit, and
:mod:`p2wss.plan.estimate` puts both together. Nothing here decides a result.
"""
