"""Figures of an asset against its views that no asset of sound views has.

Assets of true views keep within them: at worst 20 dB of radiance (shadows are not rendered), 26 of
basecolor, 23 of metallic, 5.6 degrees and an overlap of 0.96.
"""

LEAST_DB = {"radiance": 18.0, "basecolor": 25.0, "roughness": 12.0, "metallic": 12.0}
MOST_ANGLE_DEG, LEAST_OVERLAP = 9.0, 0.95
