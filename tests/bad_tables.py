"""Tables and camera files that cannot be read, and what is said of each: (content,
line, column, found)."""

HEAD = "point,x_left,y_left,x_right,y_right"
A, B = "a,1,2,3,4", "b,5,6,7,8"

BAD_TABLES = {
    "empty file": ("", 1, None, "no text"),
    "header only": (f"{HEAD}\n\n", 2, None, "no points"),
    "missing column": (
        "point,x_left,y_left,x_right\na,1,2,3",
        1,
        "y_right",
        "no such column",
    ),
    "duplicate column": (f"{HEAD},x_left\n{A},5", 1, "x_left", "second time"),
    "duplicate in the short form": (f"{HEAD},xl\n{A},5", 1, "xl", "second time"),
    "unknown column": (f"{HEAD},weight\n{A},5", 1, "weight", "unknown column 'weight'"),
    "column without a name": (f"{HEAD},\n{A},5", 1, None, "no name in field 6"),
    "blanks": (f"{HEAD}\n{A}".replace(",", " "), 1, None, "point x_left"),
    "semicolons in the header alone": (
        f"{HEAD.replace(',', ';')}\n{A}",
        2,
        "x_left",
        "1 field",
    ),
    "not a number": (f"{HEAD}\n{A}\nb,5,6,7.1x,8", 3, "x_right", "'7.1x'"),
    "number with an underscore": (f"{HEAD}\na,1_0,2,3,4", 2, "x_left", "'1_0'"),
    "no number": (f"{HEAD}\na,1,,3,4", 2, "y_left", "an empty field"),
    "NaN": (f"{HEAD}\n{A}\n\nb,5,6,7,nan", 4, "y_right", "'nan'"),
    "infinite": (f"{HEAD}\na,-inf,2,3,4", 2, "x_left", "'-inf'"),
    "too large": (f"{HEAD}\na,1e999,2,3,4", 2, "x_left", "'1e999'"),
    "negative sigma": (f"{HEAD},sigma\n{A},-.1", 2, "sigma", "'-.1'"),
    "zero sigma": (f"{HEAD},sigma\n{A},0", 2, "sigma", "'0'"),
    "same point twice": (f"{HEAD}\n{A}\n{B}\na,9,9,9,9", 4, "point", "first on line 2"),
    "point without a name": (f"{HEAD}\n ,1,2,3,4", 2, "point", "an empty field"),
    "pair without a name": (f"pair,{HEAD}\n,{A}", 2, "pair", "an empty field"),
    "too few fields": (f"{HEAD}\n{A}\nb,5,6", 3, "x_right", "3 fields"),
    "decimal commas": (f"{HEAD}\na,1,5,2,3,4", 2, None, "6 fields"),
    "open quotation": (f'{HEAD}\n"a,1,2,3,4\n{B}', 3, None, "unexpected end of data"),
    "not UTF-8": (
        f"{HEAD}\n{A}\n".encode() + "ž,5,6,7,8".encode("cp1250"),
        3,
        None,
        "0x9e",
    ),
    "UTF-16": (HEAD.encode("utf-16"), 1, None, "0xff"),
}

BAD_CAMERAS = {
    "no TOML": ("[camera]\nfocal 3", 2, None, "no valid TOML"),
    "nothing": ("", None, None, "no entries"),
    "unknown table": ("[cameras]\nfocal = 3", None, None, "cameras"),
    "mixed forms": (
        "[camera]\nfocal = 3\n[left]\nfocal = 4",
        None,
        None,
        "camera, left",
    ),
    "one side": ("[left]\nfocal = 4", None, None, "left"),
    "unknown key": (
        "[camera]\nfocal = 3\nfocus = 3 # mm",
        3,
        "camera.focus",
        "unknown key",
    ),
    "no focal length": ("\n[camera]\ny_down = true", 2, "camera.focal", "no such key"),
    "focal length as text": ('[camera]\nfocal = "3"', 2, "camera.focal", "'3'"),
    "negative focal length": (
        "[left]\nfocal = 3\n[right]\nfocal = -3",
        4,
        "right.focal",
        "-3",
    ),
    "truth as a number": ("[camera]\nfocal = true", 2, "camera.focal", "True"),
    "infinite pixel size": (
        "[camera]\nfocal = 3\npixel_size = inf",
        3,
        "camera.pixel_size",
        "inf",
    ),
    "one coordinate": (
        '[photo."1"]\nfocal = 3\nprincipal_point = [1]',
        3,
        "photo.1.principal_point",
        "[1]",
    ),
    "y_down as a number": ("[camera]\nfocal = 3\ny_down = 1", 3, "camera.y_down", "1"),
}


def write(folder, content, name):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path
