import sys; sys.path.insert(0,'.')
import graph
from collections import defaultdict
root=sys.argv[1]; pre=sys.argv[2:]
g=graph.load(root)
d=defaultdict(lambda: defaultdict(set)); tests=set()
for e in g.edges:
    f,line,test,tf,name=e[:5]
    if f==tf: continue
    if test: continue
    d[f][tf].add(name)
for f in sorted(g.files):
    if not any(f.startswith(p) for p in pre): continue
    m=g.files[f]
    if m.test: continue
    print(f)
    for tf in sorted(d[f]): print('     ',tf.replace('src/controller/','C/').replace('src/services/','S/').replace('src/observability/','O/'),':',' '.join(sorted(map(str,d[f][tf]))))
