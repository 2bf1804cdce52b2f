# SPDX-License-Identifier: Apache-2.0
"""What the modules around a table of lookups share: masks, and the habits of Kornia's image modules."""

from __future__ import annotations

from typing import Any

from jaxtyping import Bool, Shaped
from torch import Tensor, nn

from sphericalvision.core import check_choice
from sphericalvision.geometry.directions import has_numbers
from sphericalvision.geometry.masked_lookup import MaskedLookup

__all__ = ["LookupModule"]


class LookupModule(nn.Module):
    """A module of images with ``tables``, used as Kornia's ``ImageModule``: numpy or PIL in, ``show``, ``save`` out.

    What is no tensor becomes one as Kornia has it: channels first, 8 bits as [0, 1]. The last result of one image or a
    batch is kept for ``show`` and ``save`` unless ``disable_features`` is set; it is not pickled.

    Examples:
        >>> import numpy as np
        >>> from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera, Remap
        >>> to_panorama = Remap(FisheyeCamera.from_field_of_view((32, 32), 3.5), EquirectangularCamera((16, 32)))
        >>> to_panorama(np.full((32, 32, 3), 255, np.uint8), output_type="numpy").shape
        (16, 32, 3)
        >>> to_panorama.show(display=False).size
        (32, 16)
    """

    tables: MaskedLookup
    disable_features = False

    def __call__(self, image: Any, *others: Any, output_type: str = "pt", **named: Any) -> Any:
        """The result of ``forward`` as a tensor, or for ``output_type`` "numpy" or "pil" as these."""
        check_choice("output_type", output_type, ("pt", "numpy", "pil"))
        if not isinstance(image, Tensor):
            like = next(buffer for buffer in self.buffers() if buffer.is_floating_point())
            image = _images().to_tensor(image).to(like)
        found = super().__call__(image, *others, **named)
        if not self.disable_features and has_numbers(found):
            self._output_image = found.detach()
        return found if output_type == "pt" else _images()._convert_output(found, output_type)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in super().__getstate__().items() if key != "_output_image"}

    def show(self, n_row: int | None = None, display: bool = True) -> Any:
        """Show the last result, or return it as a PIL image with ``display=False``; ``n_row`` of a batch in a row."""
        return _images(self.__dict__.get("_output_image")).show(n_row, display=display)

    def save(self, name: str, n_row: int | None = None) -> None:
        """Write the last result to an image file."""
        _images(self.__dict__.get("_output_image")).save(str(name), n_row)

    def to_onnx(self, onnx_name: str, input_shape: list[int] | None = None, **options: Any) -> Any:
        """Write the module, tables included, as an ONNX file, and return the model; needs the extra ``onnx``.

        Args:
            onnx_name: the file.
            input_shape: -1 for any size; by default a batch of any size of three channels.
            **options: of Kornia's ``ONNXExportMixin.to_onnx`` and ``torch.onnx.export``.
        """
        from kornia.core.mixin.onnx import ONNXExportMixin  # a second to import

        shape = input_shape or [-1, 3, *self.tables.source_shape]
        example = [2 if size == -1 else size for size in shape]
        return ONNXExportMixin().to_onnx(
            str(onnx_name), shape, pseudo_shape=example, model=self, **{"verbose": False, **options}
        )

    def mask(self, mask: Shaped[Tensor, " ..."] | None = None) -> Bool[Tensor, " ..."]:
        """Where results are valid, bool ``(*b, *target_shape)``; ``mask`` as in ``forward``."""
        return self.tables.mask(mask)

    def __repr__(self) -> str:
        tables = self.tables
        return f"{type(self).__name__}({tables.source_shape} -> {tables.target_shape}, mode={tables.mode!r})"


def _images(last: Tensor | None = None) -> Any:
    """Kornia's conversions, of this last result."""
    from kornia.core.mixin.image_module import ImageModuleMixIn  # a second to import

    images = ImageModuleMixIn()
    images._output_image = last
    return images
