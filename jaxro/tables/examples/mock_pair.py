"""The embedded example of `jaxro clean`: a simulated pair with one wrong point, number
7.

Twelve points, two near each standard zone, relief of ±3 mm at photo scale, f = 70.64
mm, b = 63.99 mm and the elements behind table 2 of Dorozhinsky (1971); normal errors of
0.003 mm in every coordinate, and as there +1.10 mm in the right-hand y of point 7,
which stands near point 3.
"""

NAME = "simulated example"
FOCAL = 70.64
TABLE = """\
point,x_left,y_left,x_right,y_right,sigma
1,0.817,2.740,-64.777,4.031,.003
2,61.715,-4.120,-1.859,-3.065,.003
3,-3.088,65.885,-71.166,68.178,.003
4,60.469,60.747,-6.326,62.423,.003
5,1.514,-59.618,-64.316,-58.585,.003
6,66.005,-62.490,0.837,-61.314,.003
7,1.219,62.518,-64.930,65.771,.003
8,65.928,62.570,2.551,64.142,.003
9,-0.622,-65.844,-63.475,-64.822,.003
10,66.141,-65.601,0.561,-64.403,.003
11,2.179,1.289,-62.886,2.561,.003
12,59.723,0.499,-3.464,1.574,.003
"""
