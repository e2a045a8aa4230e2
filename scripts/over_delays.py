"""sb3-said over-delays, from a clone."""

from sb3_said.zoo.over_delays import main

if __name__ == "__main__":
    main()
