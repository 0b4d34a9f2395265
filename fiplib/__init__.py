"""fip: the flying inverted pendulum of unknown length, reproducible from recorded (simulated) flights."""

__version__ = "0.1.0"
