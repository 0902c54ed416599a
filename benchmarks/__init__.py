"""What jaxro costs beside its peers: `python -m benchmarks [--quick] [--only NAME]
[--update-baseline] [--gate]`.

Every comparison first compares the answers, then the time; all in float64 on the same
data in one run.
"""
