"""`python -m acsar_gym` is `acsar-gym`."""

from acsar_gym.cli import main

if __name__ == "__main__":
    main()
