"""slrig and other methods on public captures: one table, made by `python -m tests.bench.field`."""
