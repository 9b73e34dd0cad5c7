"""Writing pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR


def write_exr(path: Path, image: np.ndarray[Any, Any]) -> None:
    """Writes (H, W, 4) linear premultiplied RGBA as 32-bit OpenEXR."""
    pixels = np.ascontiguousarray(image, np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGBA": pixels}) as file:
        file.write(str(path))
