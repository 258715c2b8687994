"""The two colors that stand for ours and for one pose per image in all pictures.

They differ for every kind of color vision and in lightness, and both stand out from white by more
than 4.5 to 1 (WCAG 2.1, contrast of text).
"""

from __future__ import annotations

BLUE = "#0b3c8c"
ORANGE = "#b8540a"
