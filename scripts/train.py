"""sb3-said train, from a clone."""

from sb3_said.zoo.train import main

if __name__ == "__main__":
    main()
