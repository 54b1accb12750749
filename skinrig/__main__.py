"""Command line `python -m skinrig`, for use if the script is not on the path."""

from skinrig.cli import run

if __name__ == "__main__":
    run()
