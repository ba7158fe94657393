"""Trials of what needs compiled code or drivers: each does one small task and returns a line about it, or fails.

`reconstruction.doctor` calls each in a process of its own.
"""


def physics() -> str:
    """Drop a box of 10 cm on the ground with PhysX."""
    import sapien

    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.set_timestep(1 / 240)
    scene.add_ground(0, render=False)
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[0.05, 0.05, 0.05])  # pyright: ignore[reportArgumentType]
    box = builder.build(name="box")
    box.set_pose(sapien.Pose([0, 0, 0.3]))
    for _ in range(240):
        scene.step()
    height = float(box.pose.p[2])
    assert abs(height - 0.05) < 0.002, f"a box fell to {height:.3f} m instead of 0.050 m"
    return f"SAPIEN {sapien.__version__}; a box fell on the ground and lies still"


def rendering() -> str:
    """Render a red box with SAPIEN, on the GPU if it can."""
    import numpy as np
    import sapien
    import sapien.render

    device, name = sapien.Device("cpu"), "the CPU"
    try:
        if sapien.Device("cuda").can_render():
            device, name = sapien.Device("cuda"), "the GPU"
    except RuntimeError:
        pass
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(device)])
    scene.set_ambient_light([1, 1, 1])
    builder = scene.create_actor_builder()
    builder.add_box_visual(half_size=[0.5, 0.5, 0.5], material=[0.9, 0.1, 0.1])  # pyright: ignore[reportArgumentType]
    builder.build_static(name="box").set_pose(sapien.Pose([3, 0, 0]))
    camera = scene.add_camera("camera", 64, 64, 1.0, 0.01, 10)
    scene.update_render()
    camera.take_picture()
    picture = camera.get_picture("Color")
    red, corner = picture[32, 32, :3], picture[2, 2, :3]
    seen = [round(float(x), 2) for x in red]
    assert red[0] > 1.5 * red[1], f"a red box came out with color {seen}"
    assert np.abs(red - corner).max() > 0.2, f"a red box and the background came out with color {seen}"
    return f"SAPIEN renders on {name}"


def decoding() -> str:
    """Encode and decode a video of 10 frames with PyAV."""
    import io

    import av
    import numpy as np

    decoders = [name for name in ("h264", "hevc", "vp9", "av1") if name in av.codecs_available]
    missing = [name for name in ("h264", "hevc") if name not in decoders]
    assert not missing, f"PyAV has no decoder for {', '.join(missing)}"
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as out:
        stream = out.add_stream("libx264" if "libx264" in av.codecs_available else "mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        for value in range(0, 240, 24):
            frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), value, np.uint8), format="rgb24")
            for packet in stream.encode(frame):
                out.mux(packet)
        for packet in stream.encode():
            out.mux(packet)
    file.seek(0)
    with av.open(file) as video:
        count = sum(1 for _ in video.decode(video=0))
    assert count == 10, f"{count} of 10 frames came back from a video written and read by PyAV"
    return f"PyAV {av.__version__}; decodes {', '.join(decoders)}; wrote and read a video of 10 frames"


def cuda() -> str:
    """Look for gsplat and a CUDA device."""
    from importlib.util import find_spec

    assert find_spec("gsplat"), "gsplat is not installed"  # before torch, whose import takes seconds
    import torch

    assert torch.cuda.is_available(), f"torch {torch.__version__} sees no CUDA device"
    import gsplat  # pyright: ignore[reportMissingImports]

    return f"gsplat {getattr(gsplat, '__version__', '?')} on {torch.cuda.get_device_name(0)}"
