"""The command line as `python -m skinrig`: where the script is not on the path."""

from skinrig.cli import run

if __name__ == "__main__":
    run()
