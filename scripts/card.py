"""sb3-said card, from a clone."""

from sb3_said.zoo.card import main

if __name__ == "__main__":
    main()
