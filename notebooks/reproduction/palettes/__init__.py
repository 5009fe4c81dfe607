"""Videos drawn in a palette, as positions in the palette: not radiometric, and marked so."""

from reproduction.palettes._positions import masked_palette_video, palette_video

__all__ = ["masked_palette_video", "palette_video"]
