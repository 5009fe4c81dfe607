"""Materials whose pixels share their emissivities."""
