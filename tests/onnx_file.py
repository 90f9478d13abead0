"""A tiny ONNX network written byte by byte, so that tests need no package to build one.

Field numbers are those of onnx.proto (ONNX 1.x, the part that has never changed).
"""

import numpy as np

FLOAT, DOUBLE = 1, 11


def varint(value):
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def field(number, value):
    """One protobuf field: an integer, or bytes and texts with their length."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    body = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(body)) + body


def value_info(name, dims, kind=FLOAT):
    shape = b"".join(
        field(1, field(1, dim) if isinstance(dim, int) else field(2, dim)) for dim in dims
    )
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, shape)))


def tensor(name, values):
    dims = b"".join(field(1, dim) for dim in values.shape)
    data = values.astype(np.float32).tobytes()
    return dims + field(2, FLOAT) + field(8, name) + field(9, data)


def node(operator, inputs, outputs):
    names = b"".join(field(1, name) for name in inputs)
    return names + b"".join(field(2, name) for name in outputs) + field(4, operator)


def model(graph):
    return field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13))


def pixel_network(weights, *, bias=0.0, height=32, width=32):
    """sigmoid(weights . rgb + bias) per pixel, as a network [1, 3, h, w] -> [1, 1, h, w]."""
    return model(
        field(1, node("Conv", ["picture", "kernel", "bias"], ["logit"]))
        + field(1, node("Sigmoid", ["logit"], ["coverage"]))
        + field(2, "pixels")
        + field(5, tensor("kernel", np.asarray(weights, np.float64).reshape(1, 3, 1, 1)))
        + field(5, tensor("bias", np.array([bias])))
        + field(11, value_info("picture", [1, 3, height, width]))
        + field(12, value_info("coverage", [1, 1, height, width]))
    )


def sigmoid_network(dims, kind=FLOAT):
    """A network without weights, of any input."""
    return model(
        field(1, node("Sigmoid", ["picture"], ["coverage"]))
        + field(2, "sigmoid")
        + field(11, value_info("picture", dims, kind))
        + field(12, value_info("coverage", dims, kind))
    )
