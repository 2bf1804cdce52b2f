from .depth_loss import depth_index_huber as depth_index_huber
from .depth_loss import solid_angle_mean as solid_angle_mean
