"""What is normal in adults: published ranges that the phantom is held against."""

from __future__ import annotations

from dataclasses import dataclass

HUDSMITH = "Hudsmith et al., J. Cardiovasc. Magn. Reson. 7:775-782, 2005 (63 men, 45 women)"
PETERSEN = "Petersen et al., J. Cardiovasc. Magn. Reson. 19:18, 2017 (368 men, 432 women)"
KAWEL = "Kawel-Boehm et al., J. Cardiovasc. Magn. Reson. 17:29, 2015 (review)"
JARVINEN = "Jarvinen et al., Radiology 191:137-142, 1994 (77 +- 11 ml/m2, at 1.83 +- 0.18 m2)"


@dataclass(frozen=True, slots=True)
class Norm:
    """Mean and standard deviation of healthy men and of healthy women."""

    men: tuple[float, float]
    women: tuple[float, float]
    unit: str
    source: str

    @property
    def low(self) -> float:
        """Two deviations below the mean of the sex with the smaller values."""
        return min(mean - 2 * deviation for mean, deviation in (self.men, self.women))

    @property
    def high(self) -> float:
        """Two deviations above the mean of the sex with the larger values."""
        return max(mean + 2 * deviation for mean, deviation in (self.men, self.women))


NORMS: dict[str, Norm] = {
    "left_ventricle.largest_ml": Norm((160, 29), (135, 26), "ml", HUDSMITH),
    "left_ventricle.smallest_ml": Norm((50, 16), (42, 12), "ml", HUDSMITH),
    "left_ventricle.ejection_fraction": Norm((0.58, 0.05), (0.61, 0.05), "", PETERSEN),
    "right_ventricle.largest_ml": Norm((190, 33), (148, 35), "ml", HUDSMITH),
    "right_ventricle.smallest_ml": Norm((78, 20), (56, 18), "ml", HUDSMITH),
    "left_atrium.largest_ml": Norm((103, 30), (89, 21), "ml", HUDSMITH),
    # The product's deviation: sqrt((11 * 1.83)^2 + (77 * 0.18)^2) ml.
    "right_atrium.largest_ml": Norm((141, 24), (141, 24), "ml", JARVINEN),
    "lv_mass_g": Norm((134, 21), (98, 21), "g", KAWEL),
}
"""Figure -> norm; ``chamber.figure`` as in truth.json."""
