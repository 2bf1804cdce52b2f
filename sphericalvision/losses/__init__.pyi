from .depth import depth_index_huber as depth_index_huber
from .depth import solid_angle_cross_entropy as solid_angle_cross_entropy
from .depth import solid_angle_mean as solid_angle_mean
