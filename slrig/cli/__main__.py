"""`python -m slrig.cli`, for where the `slrig` script is not on the path."""

from slrig.cli.commands import main

if __name__ == "__main__":
    main()
