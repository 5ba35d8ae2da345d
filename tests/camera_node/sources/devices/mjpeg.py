"""A network camera: numbered pictures at a steady rate over HTTP, as cheap cameras stream them."""

import http.server
import json
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SIZE = (64, 48)
BLOCKS = 8


CALIBRATION = {
    "eye": {
        "width": SIZE[0],
        "height": SIZE[1],
        "K": [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]],
        "R_world_to_cam": np.eye(3).tolist(),
        "t_world_to_cam": [0.0, 0.0, 1.0],
    }
}


def camera_file(folder: Path, device: str, **source: Any) -> Path:
    """A scenario with one calibrated camera, eye, and further keys of its source."""
    (folder / "calibration.json").write_text(json.dumps(CALIBRATION))
    given = {"kind": "camera", "devices": {"eye": device}, "calibration": "calibration.json", "fps": 10, **source}
    (folder / "eye.yaml").write_text(json.dumps({"cameras": {"ids": ["eye"]}, "source": given}))
    return folder / "eye.yaml"


def picture(number: int) -> np.ndarray:
    """(48, 64, 3) whose upper half shows ``number`` in black and white blocks, robust to compression."""
    image = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    for k in range(BLOCKS):
        image[:24, 8 * k : 8 * k + 8] = 255 if number >> k & 1 else 0
    image[24:, :, 0] = 200  # blue in OpenCV's order
    return image


def number_of(image: np.ndarray) -> int:
    return sum(int(image[12, 8 * k + 4].mean() > 127) << k for k in range(BLOCKS))


class NetworkCamera:
    """Serves until ``close``; ``sent_ns`` says when each picture was handed to the network (clock's ns)."""

    def __init__(self, clock, fps=20.0):
        self.sent_ns: dict[int, int] = {}
        self._stop = threading.Event()
        camera = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                try:
                    while not camera._stop.is_set():
                        number = len(camera.sent_ns) % 256
                        data = cv2.imencode(".jpg", picture(number))[1].tobytes()
                        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                        camera.sent_ns[len(camera.sent_ns)] = clock.now_ns()
                        self.wfile.write(head.encode() + data + b"\r\n")
                        time.sleep(1.0 / fps)
                except OSError:
                    pass

            def log_message(self, *arguments):
                pass

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]
        self.address = f"http://127.0.0.1:{self.port}/stream.mjpeg"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self):
        self._stop.set()
        self._server.shutdown()
        self._server.server_close()
