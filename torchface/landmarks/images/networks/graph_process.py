"""The process that runs a foreign ONNX graph: run by its path, with ONNX Runtime and NumPy alone.

``python graph_process.py MEGABYTES`` reads requests at its standard input, each a count of bytes and so many: first the
graph, then crops (B,3,S,S) as written by :func:`packed`. It answers the first with the graph's signature as JSON, and
each other one with the outputs' shapes as JSON and their numbers as float32. A graph is anybody's program: here one
that never ends, or takes gigabytes, is ended without harm. The process ends where its standard input does, also while
a graph runs.
"""

import json
import os
import queue
import struct
import sys
import threading
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

MOST_BYTES, MOST_NUMBERS, MOST_AXES = 2**28, 2**24, 4  # of a request, and of an array

OUTPUTS = ("landmarks", "deviation", "visibility", "presence")


def packed(array: np.ndarray) -> bytes:
    """An array as float32: how many axes it has, their lengths, its numbers."""
    return struct.pack(f"<{1 + array.ndim}I", array.ndim, *array.shape) + np.ascontiguousarray(array, "<f4").tobytes()


def serve(incoming: BinaryIO, outgoing: BinaryIO, megabytes: int) -> None:
    """Answers requests until there are no more."""
    import onnxruntime

    requests: queue.Queue[bytes] = queue.Queue()
    threading.Thread(target=_read_all, args=(incoming, requests), daemon=True).start()
    content = requests.get()
    _limit_memory(megabytes * 2**20)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has an exception class a fault, and none above them
        _answer(outgoing, {"error": _short(error)})
        return
    _answer(outgoing, signature(session))
    while True:
        request = requests.get()
        try:
            outputs = session.run(list(OUTPUTS), {"image": unpacked(request)})
            arrays = [np.ascontiguousarray(_checked(np.asarray(one)), "<f4") for one in outputs]
        except Exception as error:  # see above
            _answer(outgoing, {"error": _short(error)})
            continue
        content = b"".join(array.tobytes() for array in arrays)
        _answer(outgoing, {"shapes": [array.shape for array in arrays]}, content)


def signature(session: Any) -> dict[str, Any]:
    """The names, shapes and types of a session's inputs and outputs, and the crop of its metadata."""
    inputs, outputs = (
        [[one.name[:100], list(one.shape[:8]), one.type[:100]] for one in puts[:64]]
        for puts in (session.get_inputs(), session.get_outputs())
    )
    crop = session.get_modelmeta().custom_metadata_map.get("crop")
    return {"inputs": inputs, "outputs": outputs, "crop": None if crop is None else crop[:100]}


def unpacked(content: bytes) -> np.ndarray:
    """The array of :func:`packed`."""
    (axes,) = struct.unpack_from("<I", content)
    shape = struct.unpack_from(f"<{axes}I", content, 4)
    return np.frombuffer(content, "<f4", offset=4 + 4 * axes).reshape(shape)


def _checked(array: np.ndarray) -> np.ndarray:
    if array.ndim > MOST_AXES or array.size > MOST_NUMBERS:
        raise ValueError(f"found an output of {array.shape}, expected at most {MOST_NUMBERS} numbers")
    return array


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:160]


def _answer(outgoing: BinaryIO, head: dict[str, Any], content: bytes = b"") -> None:
    text = json.dumps(head).encode()
    outgoing.write(struct.pack("<I", len(text)) + text + content)
    outgoing.flush()


def _read_all(incoming: BinaryIO, requests: queue.Queue[bytes]) -> None:
    """Requests as they come; ends the process where they do, whatever the graph does."""
    while len(head := incoming.read(8)) == 8:
        (count,) = struct.unpack("<Q", head)
        if count > MOST_BYTES or len(content := incoming.read(count)) < count:
            break
        requests.put(content)
    os._exit(0)


def _limit_memory(more: int) -> None:
    """Ends this process's growth at so many bytes of addresses more than it has."""
    statm = Path("/proc/self/statm")
    if sys.platform == "win32" or not statm.exists():  # no such limit there
        return
    import resource

    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    limit = int(statm.read_text().split()[0]) * os.sysconf("SC_PAGESIZE") + more
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the package prints may not come among the answers
    serve(sys.stdin.buffer, answers, int(sys.argv[1]))
