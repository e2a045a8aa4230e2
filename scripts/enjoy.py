"""sb3-said enjoy, from a clone."""

from sb3_said.zoo.enjoy import main

if __name__ == "__main__":
    main()
