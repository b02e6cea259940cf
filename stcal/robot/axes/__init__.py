"""The axis method: a robot from sweeps of its joints."""
