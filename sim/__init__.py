"""The tank in software: what a webcam would see of a laser line under water, and the truth of it.

What is named here is the public interface; each name is loaded when it is first asked for.

    import sim

    scene = sim.load_scene("scene.toml")
    picture = sim.render_picture(scene)
    truth = sim.stripe_truth(scene, 0.0)
    with sim.EmulatedHardware(scene) as hardware:  # a webcam and a track for lscan
        print(hardware.url, hardware.port)
"""

from lscan.files.publicnames import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __file__)
