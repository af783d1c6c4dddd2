#!/usr/bin/python3
"""Projections of a scan directory in other tools' formats, written without any of the project's code.

Usage: images.py mha|npy|tiff|pages|tiles|dicom|enhanced|his|hnd|xim|xtekct|nexus|exchange|txrm SCAN OUT [OPTION=VALUE ...]
"""
import json
import os
import struct
import sys
import zlib

import numpy


def load(scan):
    """The document and [view][row][column]."""
    with open(os.path.join(scan, "scan.json"), encoding="utf-8") as file:
        document = json.load(file)
    shape = document["projections"]["count"], document["detector"]["rows"], document["detector"]["columns"]
    kind = "<f4" if document["projections"]["sample"] == "float32" else "<u2"
    return document, numpy.fromfile(os.path.join(scan, "projections.raw"), kind).reshape(shape)


def to_type(images, options):
    """As another type, times a factor: type=<i2 factor=100."""
    kind = numpy.dtype(options.get("type", images.dtype.str))
    images = images * float(options.get("factor", 1))
    return (numpy.rint(images) if kind.kind in "iu" else images).astype(kind)


def write_mha(document, images, out, options):
    """type=, data=FILE for pixels beside the header, header=BYTES before them, packed=1."""
    kinds = {"u1": "UCHAR", "i1": "CHAR", "u2": "USHORT", "i2": "SHORT", "u4": "UINT", "i4": "INT", "f4": "FLOAT", "f8": "DOUBLE"}
    images = to_type(images, options)
    packed, beside = "packed" in options, options.get("data")
    pixels = zlib.compress(images.tobytes()) if packed else images.tobytes()
    pitch = document["detector"]["pixel_mm"]
    count, rows, columns = images.shape
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "BinaryData = True",
        f"BinaryDataByteOrderMSB = {images.dtype.str[0] == '>'}",
        f"CompressedData = {packed}",
        f"Offset = {-0.5 * (columns - 1) * pitch[0]!r} {-0.5 * (rows - 1) * pitch[1]!r} 0",
        f"ElementSpacing = {pitch[0]!r} {pitch[1]!r} 1",
        f"DimSize = {columns} {rows} {count}",
        f"ElementType = MET_{kinds[images.dtype.str[1:]]}",
    ]
    if "header" in options:
        lines.append(f"HeaderSize = {options['header']}")
        pixels = bytes(int(options["header"]) if options["header"] != "-1" else 13) + pixels
    lines.append(f"ElementDataFile = {beside or 'LOCAL'}\n")
    with open(out, "wb") as file:
        file.write("\n".join(lines).encode())
        if beside is None:
            file.write(pixels)
    if beside is not None:
        with open(os.path.join(os.path.dirname(out), beside), "wb") as file:
            file.write(pixels)


def tiff_page(image, offset, last, strips=3, tile=0, packed=False):
    """One image file directory behind its pixels, all of it to stand at `offset` (TIFF 6.0)."""
    order = ">" if image.dtype.str[0] == ">" else "<"
    rows, columns = image.shape
    if tile:
        blocks = []
        for y in range(0, rows, tile):
            for x in range(0, columns, tile):
                block = numpy.zeros((tile, tile), image.dtype)
                part = image[y : y + tile, x : x + tile]
                block[: part.shape[0], : part.shape[1]] = part
                blocks.append(block.tobytes())
    else:
        each = -(-rows // strips)
        blocks = [image[y : y + each].tobytes() for y in range(0, rows, each)]
    if packed:
        blocks = [zlib.compress(block) for block in blocks]
    data, places = b"", []
    for block in blocks:
        places.append(offset + len(data))
        data += block + b"\0" * (len(block) % 2)
    lists = offset + len(data)
    data += struct.pack(f"{order}{len(blocks)}I", *places) + struct.pack(f"{order}{len(blocks)}I", *map(len, blocks))
    inline = len(blocks) == 1
    place = places[0] if inline else lists
    length = len(blocks[0]) if inline else lists + 4 * len(blocks)
    tags = [
        (256, 4, 1, columns),
        (257, 4, 1, rows),
        (258, 3, 1, image.dtype.itemsize * 8),
        (259, 3, 1, 8 if packed else 1),
        (262, 3, 1, 1),
        (277, 3, 1, 1),
        (339, 3, 1, {"u": 1, "i": 2, "f": 3}[image.dtype.kind]),
    ]
    if tile:
        tags += [(322, 4, 1, tile), (323, 4, 1, tile), (324, 4, len(blocks), place), (325, 4, len(blocks), length)]
    else:
        tags += [(273, 4, len(blocks), place), (278, 4, 1, each), (279, 4, len(blocks), length)]
    directory = offset + len(data)
    data += struct.pack(order + "H", len(tags))
    for tag, kind, count, value in sorted(tags):
        data += struct.pack(order + "HHI", tag, kind, count)
        data += struct.pack(order + ("I" if kind == 4 else "HH"), *((value,) if kind == 4 else (value, 0)))
    end = directory + 2 + 12 * len(tags) + 4
    return data + struct.pack(order + "I", 0 if last else end), directory, end


def write_tiff(images, out, **how):
    """All images as pages of one file. A page's directory stands behind its pixels: the chain is mended as it grows."""
    big = images.dtype.str[0] == ">"
    order = ">" if big else "<"
    data = bytearray(struct.pack(order + "2sHI", b"MM" if big else b"II", 42, 0))
    link = 4
    for image in images:
        page, directory, end = tiff_page(image, len(data), True, **how)
        data += page
        data[link : link + 4] = struct.pack(order + "I", directory)
        link = end - 4
    with open(out, "wb") as file:
        file.write(data)


def write_folder(images, out, **how):
    """proj_1.tif, proj_2.tif ... proj_10.tif: numbers without zeros before them."""
    os.makedirs(out, exist_ok=True)
    for k, image in enumerate(images):
        write_tiff(image[None], os.path.join(out, f"proj_{k + 1}.tif"), **how)


def first_and_step(document):
    """Gantry angles to DICOM's: the source behind the patient, at +y, is primary angle 0."""
    geometry = document["geometry"]
    return geometry["first_angle_deg"] - 90, geometry["angle_step_deg"]


DICOM_HEAD = """(0002,0010) UI [{syntax}]
(0008,0016) UI [{sop_class}]
(0008,0018) UI [1.2.3.4.5.6]
(0008,0060) CS [XA]
(0010,0010) PN [M\udcfcller^Test]
"""
DICOM_PIXELS = """(0028,0002) US 1
(0028,0004) CS [MONOCHROME2]
(0028,0008) IS [{frames}]
(0028,0010) US {rows}
(0028,0011) US {columns}
(0028,0100) US 16
(0028,0101) US 16
(0028,0102) US 15
(0028,0103) US 0
(0028,1040) CS [LIN]
"""


def dicom_images(document, images, out):
    """Shown as one faces the patient: turned by half a turn against the scan's own order."""
    pixels = os.path.basename(out) + ".pixels"
    numpy.ascontiguousarray(images[:, ::-1, ::-1]).astype("<u2").tofile(os.path.join(os.path.dirname(out), pixels))
    geometry, pitch = document["geometry"], document["detector"]["pixel_mm"]
    return {
        "frames": images.shape[0],
        "rows": images.shape[1],
        "columns": images.shape[2],
        "pixels": f"(7fe0,0010) OW ={pixels}\n",
        "distance": f"(0018,1110) DS [{geometry['source_to_detector_mm']}]\n",
        "spacing": f"(0018,1164) DS [{pitch[1]}\\{pitch[0]}]\n",
    }


def write_dump(text, out):
    with open(out, "wb") as file:
        file.write(text.encode("latin-1", "surrogateescape"))


def write_dicom(document, images, out, options):
    """A dump for dump2dcm of an XA object; increments=each writes each frame's offset, else one step."""
    parts = dicom_images(document, images, out)
    first, step = first_and_step(document)
    increments = [f"{step:.12g}"] if options.get("increments") != "each" else [f"{step * k:.12g}" for k in range(parts["frames"])]
    text = DICOM_HEAD.format(syntax="1.2.840.10008.1.2.1", sop_class="1.2.840.10008.5.1.4.1.1.12.1")
    text += parts["distance"] + f"(0018,1111) DS [{document['geometry']['source_to_isocentre_mm']}]\n" + parts["spacing"]
    text += f"(0018,1500) CS [DYNAMIC]\n(0018,1510) DS [{first}]\n(0018,1511) DS [0]\n"
    text += "(0018,1520) DS [" + "\\".join(increments) + "]\n"
    if "patient" in options:
        text += f"(0018,5100) CS [{options['patient']}]\n"
    if "orientation" in options:
        text += "(0020,0020) CS [" + options["orientation"].replace("-", "\\") + "]\n"
    for key, value in options.items():  # who:0010,0020,LO=4711
        if key.startswith("who:"):
            text += f"({key[4:13]}) {key[14:16]} [{value}]\n"
    text += DICOM_PIXELS.format(**parts) + parts["pixels"]
    write_dump(text, out)


def write_enhanced(document, images, out, options):
    """A dump of an Enhanced XA object: distances and spacing shared, angles in each frame's functional groups."""
    parts = dicom_images(document, images, out)
    first, step = first_and_step(document)
    text = DICOM_HEAD.format(syntax="1.2.840.10008.1.2.1", sop_class="1.2.840.10008.5.1.4.1.1.12.1.1")
    text += DICOM_PIXELS.format(**parts)
    text += "(5200,9229) SQ\n(fffe,e000) na\n(0018,9476) SQ\n(fffe,e000) na\n" + parts["distance"]
    text += f"(0018,9402) FL {document['geometry']['source_to_isocentre_mm']}\n(fffe,e00d) na\n(fffe,e0dd) na\n"
    text += "(0028,9443) SQ\n(fffe,e000) na\n" + parts["spacing"] + "(fffe,e00d) na\n(fffe,e0dd) na\n"
    text += "(fffe,e00d) na\n(fffe,e0dd) na\n(5200,9230) SQ\n"
    for k in range(parts["frames"]):
        text += "(fffe,e000) na\n(0018,9405) SQ\n(fffe,e000) na\n"
        text += f"(0018,1510) DS [{first + step * k:.12g}]\n(0018,1511) DS [{options.get('secondary', 0)}]\n"
        text += "(fffe,e00d) na\n(fffe,e0dd) na\n(fffe,e00d) na\n"
    text += "(fffe,e0dd) na\n" + parts["pixels"]
    write_dump(text, out)


def write_his(images, out):
    """Heimann's header of version 100, falling counts as Elekta writes them, all images in a file."""
    count, rows, columns = images.shape
    head = struct.pack("<HHHIHHHHHHHdH", 0x7000, 68, 100, 168 + images.nbytes, 100, 1, 1, rows, columns, count, 0, 0.1, 4)
    with open(out, "wb") as file:
        file.write(head.ljust(68 + 100, b"\0") + (65535 - images).astype("<u2").tobytes())


def differences(image):
    """Varian's: a table of lengths, the first row and a pixel as they are, then differences in 1, 2 or 4 bytes."""
    rows, columns = image.shape
    flat = image.astype(numpy.int64).ravel()
    table, steps = [], flat[:columns + 1].astype("<i4").tobytes()
    for i in range(columns + 1, rows * columns):
        step = int(flat[i] - flat[i - 1] - flat[i - columns] + flat[i - columns - 1])
        kind = 0 if -128 <= step < 128 else 1 if -32768 <= step < 32768 else 2
        table.append(kind)
        steps += step.to_bytes(1 << kind, "little", signed=True)
    table += [0] * (-len(table) % 4)
    packed = bytes(a | b << 2 | c << 4 | d << 6 for a, b, c, d in zip(*[iter(table)] * 4))
    # A table of the size that the pixels would have with one more.
    return packed.ljust(((rows - 1) * columns + 3) // 4, b"\0"), steps


def write_varian(document, images, out, kind):
    """A file for each image. .xim: every other one is not compressed."""
    pitch = document["detector"]["pixel_mm"]
    os.makedirs(out, exist_ok=True)
    for k, image in enumerate(images):
        rows, columns = image.shape
        table, steps = differences(image)
        if kind == "hnd":
            head = b"VARIAN_VA_INTERNAL_1.0".ljust(120, b"\0") + struct.pack("<II", columns, rows)
            data = (head.ljust(352, b"\0") + struct.pack("<dd", *pitch)).ljust(1024, b"\0") + table + steps
        else:
            data = b"VMS.XI\0\0" + struct.pack("<6i", 1, columns, rows, 32, 4, int(k % 2 == 0))
            if k % 2 == 0:
                data += struct.pack("<i", len(table)) + table + struct.pack("<i", len(steps)) + steps + struct.pack("<i", 4 * image.size)
            else:
                data += struct.pack("<i", 4 * image.size) + image.astype("<i4").tobytes()
            data += struct.pack("<3i", 2, 5, 6) + struct.pack("<i", 4)
            for name, value in (("KVSourceRtn", 17.5), ("PixelWidth", pitch[0] / 10), ("PixelHeight", pitch[1] / 10)):
                data += struct.pack("<i", len(name)) + name.encode() + struct.pack("<id", 1, value)
            data += struct.pack("<i", 4) + b"Text" + struct.pack("<ii", 2, 3) + b"abc"
        with open(os.path.join(out, f"Proj_{k + 1:05}.{kind}"), "wb") as file:
            file.write(data)


def stage_angles(document):
    """Degrees of the table that turns the object, which is the source the other way round."""
    geometry = document["geometry"]
    if "angles_deg" in geometry:
        return [-angle for angle in geometry["angles_deg"]]
    first, step = geometry.get("first_angle_deg", 0), geometry["angle_step_deg"]
    return [-(first + k * step) for k in range(document["projections"]["count"])]


def write_xtekct(document, images, out):
    """OUT.xtekct, with carriage returns, and OUT_0001.tif and so on."""
    geometry, angles = document["geometry"], stage_angles(document)
    count, rows, columns = images.shape
    lines = {"Name": "ball", "VoxelsX": columns, "DetectorPixelsX": columns, "DetectorPixelsY": rows,
             "DetectorPixelSizeX": document["detector"]["pixel_mm"][0], "DetectorPixelSizeY": document["detector"]["pixel_mm"][1],
             "SrcToObject": geometry["source_to_isocentre_mm"], "SrcToDetector": geometry["source_to_detector_mm"],
             "DetectorOffsetX": 0, "DetectorOffsetY": 0, "Projections": count, "InitialAngle": repr(angles[0]),
             "AngularStep": repr(angles[1] - angles[0]), "WhiteLevel": 50000, "Scale": 1}
    with open(out + ".xtekct", "w", encoding="utf-8", newline="") as file:
        file.write("[XTekCT]\r\n" + "".join(f"{key}={value}\r\n" for key, value in lines.items()) + "[Xrays]\r\nXraykV=120\r\n")
    for k, image in enumerate(images):
        write_tiff(image[None], f"{out}_{k + 1:04}.tif")


def write_hdf5(document, images, out, nexus):
    """By h5py: NXtomo with a flat image at either end and lengths in several units, or Data Exchange, compressed."""
    import h5py

    geometry, pitch, angles = document["geometry"], document["detector"]["pixel_mm"], stage_angles(document)
    with h5py.File(out, "w") as file:
        if not nexus:
            file.create_dataset("exchange/data", data=images, chunks=(1,) + images.shape[1:], compression="gzip", shuffle=True)
            file["exchange/theta"] = numpy.array(angles, "f8")
            return
        flat = numpy.full_like(images[:1], 50000)
        detector = file.create_group("entry/instrument/detector")
        detector["data"] = numpy.concatenate([flat, images, flat])
        detector["image_key"] = numpy.array([1] + [0] * len(images) + [1], "i4")
        file["entry/sample/rotation_angle"] = numpy.array([0] + angles + [0], "f8")
        to_axis, to_detector = geometry["source_to_isocentre_mm"], geometry["source_to_detector_mm"]
        for name, value, unit in (("instrument/detector/x_pixel_size", pitch[0] * 1e3, "um"), ("instrument/detector/y_pixel_size", pitch[1], numpy.bytes_("mm")),
                                  ("instrument/detector/distance", (to_detector - to_axis) / 1e3, "m"), ("instrument/source/distance", -to_axis / 10, "cm")):
            file["entry/" + name] = value
            file["entry/" + name].attrs["units"] = unit


def write_compound(streams, out):
    """[MS-CFB] of the version 3: {(storage, name): bytes}. Children hang to the right, one below the other."""
    end, free, sector = 0xFFFFFFFE, 0xFFFFFFFF, 512
    storages = list(dict.fromkeys(storage for storage, _ in streams))
    small, mini, data, fat, entries = b"", [], b"", [], []

    def place(content):
        nonlocal data
        if not content:
            return end
        first, count = len(fat), -(-len(content) // sector)
        fat.extend([*range(first + 1, first + count), end])
        data += content.ljust(count * sector, b"\0")
        return first

    def entry(name, kind, right=free, child=free, start=0, size=0):
        text = (name + "\0").encode("utf-16-le")
        return text.ljust(64, b"\0") + struct.pack("<HBB3I16sI8s8sIQ", len(text), kind, 1, free, right, child, b"", 0, b"", b"", start, size)

    place_of = {}
    for key, content in streams.items():
        if len(content) >= 4096:
            place_of[key] = place(content)
            continue
        count = -(-len(content) // 64)
        place_of[key] = len(mini) if count else end
        mini.extend([*range(len(mini) + 1, len(mini) + count), end] if count else [])
        small += content.ljust(count * 64, b"\0")
    at = 1 + len(storages)
    for i, storage in enumerate(storages):
        inside = [key for key in streams if key[0] == storage]
        entries.append(entry(storage, 1, 2 + i if i + 1 < len(storages) else free, at))
        at += len(inside)
    for storage in storages:
        inside = [key for key in streams if key[0] == storage]
        for i, key in enumerate(inside):
            here = 1 + len(entries)
            entries.append(entry(key[1], 2, here + 1 if i + 1 < len(inside) else free, free, place_of[key], len(streams[key])))
    root = entry("Root Entry", 5, free, 1, place(small), len(small))
    directory = place(root + b"".join(entries))
    places = b"".join(struct.pack("<I", value) for value in mini)
    minis = place(places.ljust(-(-len(places) // sector) * sector, b"\xff"))
    count = 1
    while count * 128 < len(fat) + count:
        count += 1
    first = len(fat)
    table = fat + [0xFFFFFFFD] * count
    table += [free] * (count * 128 - len(table))
    assert count <= 109
    head = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(16) + struct.pack("<HHHHH6xIIIIIIIIII", 0x3E, 3, 0xFFFE, 9, 6, 0, count, directory, 0, 4096, minis, -(-len(places) // sector), end, 0, 0)[:-4]
    head += b"".join(struct.pack("<I", first + i if i < count else free) for i in range(109))
    with open(out, "wb") as file:
        file.write(head + data + struct.pack(f"<{len(table)}I", *table))


def write_txrm(document, images, out):
    """Streams of Zeiss's; python3-olefile, which others wrote, reads the file back where it is here."""
    geometry, count = document["geometry"], len(images)
    to_axis, to_detector = geometry["source_to_isocentre_mm"], geometry["source_to_detector_mm"]
    pitch = document["detector"]["pixel_mm"][0]
    streams = {("ImageInfo", name): struct.pack("<i", value) for name, value in
               (("ImageWidth", images.shape[2]), ("ImageHeight", images.shape[1]), ("NoOfImages", count), ("DataType", 5))}
    streams["ImageInfo", "Angles"] = numpy.array(stage_angles(document), "<f4").tobytes()
    streams["ImageInfo", "PixelSize"] = struct.pack("<f", 1e3 * pitch * to_axis / to_detector)
    streams["ImageInfo", "StoRADistance"] = numpy.full(count, -to_axis, "<f4").tobytes()
    streams["ImageInfo", "DtoRADistance"] = numpy.full(count, to_detector - to_axis, "<f4").tobytes()
    for k, image in enumerate(images):
        streams[f"ImageData{k // 100 + 1}", f"Image{k + 1}"] = image.astype("<u2").tobytes()
    write_compound(streams, out)
    try:
        import olefile
    except ImportError:
        return
    with olefile.OleFileIO(out) as ole:
        for (storage, name), content in streams.items():
            assert ole.openstream([storage, name]).read() == content, name


def main():
    """The command line."""
    kind, scan, out = sys.argv[1:4]
    options = dict(word.split("=", 1) for word in sys.argv[4:])
    document, images = load(scan)
    if kind == "mha":
        write_mha(document, images, out, options)
    elif kind == "npy":
        numpy.save(out, to_type(images, options))
    elif kind == "tiff":
        write_folder(to_type(images, options), out)
    elif kind == "pages":
        write_tiff(to_type(images, options), out, packed=True)
    elif kind == "tiles":
        write_folder(to_type(images, options), out, tile=16)
    elif kind == "dicom":
        write_dicom(document, images, out, options)
    elif kind == "enhanced":
        write_enhanced(document, images, out, options)
    elif kind == "his":
        write_his(images, out)
    elif kind in ("hnd", "xim"):
        write_varian(document, images, out, kind)
    elif kind == "xtekct":
        write_xtekct(document, images, out)
    elif kind in ("nexus", "exchange"):
        write_hdf5(document, images, out, kind == "nexus")
    elif kind == "txrm":
        write_txrm(document, images, out)
    else:
        sys.exit(f"no format {kind}")


main()
