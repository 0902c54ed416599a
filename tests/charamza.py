"""A network of twelve points with directions and distances: F. Charamza 1990, GEODET/PC,
User's Guide, Zdiby, page 238; as XML input of GNU Gama and as tables. Adjusted
coordinates, standard deviations and m0 as GNU Gama 1.13 prints them."""

DIRECTIONS = """\
1: 2 0.0000 422 28.2057 424 60.4906 403 324.3662 407 382.8182
2: 1 0.0000 407 22.2376 409 73.8984 411 134.2090 416 203.0706 418 287.2951 420 345.6928 422 368.9908
403: 1 0.0000 407 313.5542
407: 1 0.0000 403 55.1013 409 193.3410 2 239.4204 422 323.5443
409: 2 0.0000 407 102.2575 411 310.1751
411: 2 0.0000 409 49.8647 413 291.4953 416 337.6667
413: 411 0.0000 416 295.3582
416: 2 0.0000 411 68.8065 413 117.9922 418 348.1606
418: 2 0.0000 416 63.9347 420 336.3190
420: 2 0.0000 418 77.9221 422 250.1804
422: 2 0.0000 420 26.8834 424 225.7964 1 259.2124 407 337.3724
424: 1 0.0000 422 134.2955
"""

DISTANCES = """\
1: 2 845.777 422 493.793 424 288.301 403 388.536 407 498.750
2: 407 388.562 409 257.498 411 360.282 416 338.919 418 292.094 420 261.408 422 452.249
403: 407 405.4030
407: 409 281.997 422 346.415
409: 411 296.281
411: 413 252.266 416 360.449
413: 416 239.745
416: 418 389.397
418: 420 246.594
420: 422 228.207
422: 424 279.405
"""

FIXED = {"1": (1054980.484, 644498.590), "2": (1054933.801, 643654.101)}

ADJUSTED = """\
403 1054612.595217 644373.608482
407 1054821.163144 644025.975421
409 1054703.670300 643769.618153
411 1054614.588716 643487.045497
413 1054700.743544 643249.947256
416 1054931.433693 643315.193515
418 1055216.472347 643580.486995
420 1055139.898861 643814.894551
422 1055167.222373 644041.461419
424 1055205.411422 644318.242998
"""

M0 = 9.6360820
"""Of the standard deviation 10 of unit weight."""

VARIANCE_403 = 13.819516
"""mm², of the x of the point 403."""


def table(text):
    """Station, target and value of every entry, in the order of the stations."""
    found = []
    for line in text.splitlines():
        station, entries = line.split(":")
        entries = entries.split()
        found += [
            (station, b, v) for b, v in zip(entries[::2], entries[1::2], strict=True)
        ]
    return found


def as_xml():
    """The input of gama-local; only two points have coordinates."""
    fixed = "".join(
        f'<point id="{name}" x="{x}" y="{y}" fix="xy"/>\n'
        for name, (x, y) in FIXED.items()
    )
    others = "".join(
        f'<point id="{line.split()[0]}" adj="xy"/>\n' for line in ADJUSTED.splitlines()
    )
    stations = [line.split(":")[0] for line in DIRECTIONS.splitlines()]
    sights = ""
    for station in stations:
        sights += f'<obs from="{station}">\n'
        for element, text in (("direction", DIRECTIONS), ("distance", DISTANCES)):
            for a, b, value in table(text):
                if a == station:
                    sights += f'<{element} to="{b}" val=" {value} "/>\n'
        sights += "</obs>\n"
    return f"""<?xml version="1.0" ?>
<gama-local xmlns="http://www.gnu.org/software/gama/gama-local">
<network axes-xy="sw" angles="left-handed">
<description>Frantisek Charamza: GEODET/PC</description>
<parameters sigma-apr=" 10 " conf-pr="0.95" tol-abs="1000" sigma-act="aposteriori"/>
<points-observations distance-stdev="5.0" direction-stdev="10.0">
{fixed}{others}<!-- twelve stations -->
{sights}</points-observations>
</network>
</gama-local>
"""


def as_tables():
    """The same for `jaxro adjust`: measurements, and points."""
    lines = "kind,from,to,value,sigma\n"
    lines += "".join(f"direction,{a},{b},{v},0.001\n" for a, b, v in table(DIRECTIONS))
    lines += "".join(f"distance,{a},{b},{v},0.005\n" for a, b, v in table(DISTANCES))
    points = "point,X,Y,role\n" + "".join(
        f"{name},{x},{y},control\n" for name, (x, y) in FIXED.items()
    )
    return lines, points
