"""`python -m accord.cli`, where the script `accord` is not on the path."""

from accord.cli.main import main

if __name__ == "__main__":
    main()
