"""An L-shaped corridor, a robot that drives through it, and a particle filter that draws its
map."""
