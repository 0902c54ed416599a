"""The embedded example: six von Gruber points of one aerial pair, with the printed
solution to compare with.

Public domain: B. A. Dewitt, sample of the program `relor`, wide-angle camera, f =
152.113 mm. His solution, dependent elements with bx = 91.9825 mm (the mean x-parallax),
rigorous weights, one degree of freedom:

    by    -1.7187 ± 0.0209 mm      omega  2.4077 ± 0.0065°
    bz    -3.8105 ± 0.0075 mm      phi    0.5550 ± 0.0069°      sigma0 0.0045 mm
                                   kappa -0.2053 ± 0.0032°
"""

NAME = "example"
FOCAL = 152.113
TABLE = """\
point,x_left,y_left,x_right,y_right
a,-4.878,1.974,-97.920,-2.923
b,89.307,2.709,-1.507,-1.856
c,.261,84.144,-90.917,78.970
d,90.334,83.843,-1.571,79.470
e,-4.668,-86.821,-100.060,-95.748
f,88.599,-85.274,-.965,-94.319
"""
