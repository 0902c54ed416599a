"""The embedded example of `jaxro adjust`: a simulated network of six points with directions
(gon), distances and height differences, two points known; the distance 3-2 is 50 mm too
long."""

NAME = "simulated network"
NETWORK = """\
kind,from,to,value,sigma
direction,A,1,400.0000,0.0012
direction,A,3,366.7981,0.0012
direction,A,B,339.1092,0.0012
direction,B,A,0.0009,0.0012
direction,B,3,366.6890,0.0012
direction,B,2,304.5381,0.0012
direction,B,4,269.5229,0.0012
direction,3,A,399.9984,0.0012
direction,3,1,305.3612,0.0012
direction,3,2,215.5026,0.0012
direction,3,B,138.9985,0.0012
direction,1,A,0.0006,0.0012
direction,1,3,72.1559,0.0012
direction,1,2,142.9291,0.0012
direction,2,1,399.9989,0.0012
direction,2,3,39.3715,0.0012
direction,2,B,100.7200,0.0012
direction,2,4,152.9128,0.0012
direction,4,2,399.9999,0.0012
direction,4,B,112.7921,0.0012
distance,A,1,332.418,0.004
distance,A,3,302.199,0.004
distance,B,3,254.802,0.004
distance,B,4,215.870,0.004
distance,1,2,283.061,0.004
distance,3,2,257.050,0.004
distance,1,3,166.207,0.004
distance,2,4,154.351,0.004
height,A,1,3.5875,0.002
height,1,2,7.2968,0.002
height,2,B,-1.6464,0.002
height,B,3,-4.4533,0.002
height,3,A,-4.7871,0.002
height,2,4,3.5973,0.002
height,4,B,-5.2483,0.002
height,3,1,-1.2005,0.002
"""
POINTS = """\
point,X,Y,Z,role
A,1000,1000,52.314,control
B,1480,1120,61.552,control
1,1119,1311,,approximate
2,1391,1393,,approximate
3,1236,1191,,approximate
4,1529,1332,,approximate
"""
