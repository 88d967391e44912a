"""The digital calibration certificate of an identified machine."""
