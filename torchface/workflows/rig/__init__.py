"""An actor's own rig from raw scans."""
