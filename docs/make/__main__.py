"""The program that makes this project's own pages: ``python docs/make --help``."""

from commands import main

if __name__ == "__main__":
    main()
