"""The judge of the renderers: light of all higher orders by walks whose weights are bounded.

Photons leave the laser and scatter as chance has it; walks leave the camera likewise.  They meet
on surfaces, or in the water where the light turns most, in cells much smaller than the light
varies (``cells``).  Neither is aimed at the other, so no place within a phase function's peak
weighs more than chance finds it: the noise falls as the root of the effort, without specks, in
water of any turbidity.  It is slow.  It keeps its light apart by families, so that others can be
compared with it one by one.
"""
