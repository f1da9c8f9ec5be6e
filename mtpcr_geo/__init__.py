"""Registration of ground and aerial lidar clouds through bird's-eye-view height images."""

__version__ = "0.1.0"
