"""Run the `mapt` command as `python -m mapt.cli`, where the script is not on the path."""

from mapt.cli.main import main

if __name__ == "__main__":
    main()
