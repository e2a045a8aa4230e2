"""sb3-said export, from a clone."""

from sb3_said.zoo.export import main

if __name__ == "__main__":
    main()
