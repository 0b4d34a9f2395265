"""The firmware Betaflight as inner loop: its process, and a vehicle with motors for it to fly."""
