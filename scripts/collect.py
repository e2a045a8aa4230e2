"""sb3-said collect, from a clone."""

from sb3_said.zoo.collect import main

if __name__ == "__main__":
    main()
