import sys,os,re; sys.path.insert(0,'.')
import plan, graph
from plan import *
from moves import MOVES
from ext import EXT
ROOT=sys.argv[1]
g=load(ROOT)
INLINE=re.compile(r"^#\[cfg\(test\)\]\n(?:#\[.*\]\n)*(?:pub(?:\([a-z]+\))? )?mod \w+ \{",re.M)
T=re.compile(r"(^|/)(tests|fuzz)(/|\.rs$)|_tests\.rs$")
def lines(f):
    ps=(INLINE.split(open(os.path.join(ROOT,f)).read(),maxsplit=1)+[''])[:2]
    a,b=[sum(1 for l in x.splitlines() if l.strip() and not l.strip().startswith('//')) for x in ps]
    return (0,a+b) if T.search(f) or (f in g.files and g.files[f].test) else (a,b)
rs=[]
for top in('src','crates'):
    for d,_,fs in os.walk(os.path.join(ROOT,top)):
        rs+=[os.path.relpath(os.path.join(d,f),ROOT) for f in fs if f.endswith('.rs')]
rs.sort()
GO={'14/15/18':['src/controller/leaderboards/queue_readers.rs','src/controller/leaderboards/shared_queue.rs','src/controller/submissions/decide/restored.rs','src/controller/submissions/decide/stored.rs','src/controller/submissions/decide/tests/restored.rs','src/controller/submissions/foreign_runs.rs','src/controller/submissions/questions.rs','crates/api/src/imported.rs'],
'16':['src/controller/submissions/decide/observe.rs','src/controller/submissions/decide/tests/observe.rs','src/controller/submissions/other_results.rs'],
'19':['src/services/evalai/queue/outlook.rs'],'27':['src/services/evalai/queue/inbox.rs','src/services/evalai/queue/tests/inbox.rs'],
'20':['src/controller/submissions/archive/text_budget.rs','src/services/held_text.rs'],
'24':['src/controller/leaderboards/images.rs','src/controller/submissions/team_use.rs'],'26':['src/controller/submissions/reruns.rs'],
'report as JSON':['crates/kubectl-leaderboard/src/report/zip.rs','crates/kubectl-leaderboard/src/transitions.rs']}
goes={f:r for r,fs in GO.items() for f in fs}
tab=defaultdict(list); size=defaultdict(lambda:[0,0,0])
for f in rs:
    c,n=target(f); a,b=lines(f)
    tab[c].append((f,n,a,b)); size[c][0]+=1; size[c][1]+=a; size[c][2]+=b
out=open('A.md','w'); tsv=open('crates.tsv','w')
for f in rs: print(f,*target(f),goes.get(f,''),sep='\t',file=tsv)
print('| crate | files | product lines | lines of tests | of the files move |\n|---|---|---|---|---|',file=out)
for c in ORDER: print('| %s | %d | %d | %d | %d |'%(c,*size[c],sum(1 for x in tab[c] if x[0]!=x[1])),file=out)
print('| all | %d | %d | %d | %d |'%(*[sum(size[c][i] for c in ORDER) for i in range(3)],sum(1 for c in ORDER for x in tab[c] if x[0]!=x[1])),file=out)
for c in ORDER:
    print('\n#### %s\n'%c,file=out)
    mv=[x for x in tab[c] if x[0]!=x[1]]; st=[x for x in tab[c] if x[0]==x[1]]
    if mv:
        print('| today | then | lines |\n|---|---|---|',file=out)
        for f,n,a,b in mv: print('| %s%s | %s | %d |'%(f,' *(goes: %s)*'%goes[f] if f in goes else '',n,a+b),file=out)
    if st:
        d=defaultdict(list)
        for f,n,a,b in st: d[os.path.dirname(f)].append(os.path.basename(f)+('(goes: %s)'%goes[f] if f in goes else ''))
        print('\nStays where it is: '+'; '.join('`%s/`: %s'%(k,', '.join(v)) for k,v in sorted(d.items())),file=out)
print(len(rs),'files',sum(len(v) for v in tab.values()),'rows; unique targets',len({target(f)[1] for f in rs}))
# extern crates by target
ci=crate_of_items(g,MOVES); d=defaultdict(lambda:{False:set(),True:set()})
for file,line,test,m,segs,alias,vis in g.uses:
    if segs[0] in EXT and file.startswith(('src/','crates/')):
        d[target(file)[0]][test].add(segs[0])
for it in g.items:
    if not it.file.startswith(('src/','crates/')): continue
    for i,t in enumerate(it.toks):
        if t.k=='id' and t.v in EXT and i+1<len(it.toks) and it.toks[i+1].k=='cc' and (i==0 or it.toks[i-1].k!='cc') and not any(e[0]=='mod' for e in it.mod.names.get(t.v,[])): d[ci[it]][it.test].add(t.v)
    for a in it.attr:
        for mm in re.finditer(r'\b([a-z_0-9]+)\s*::',a):
            if mm.group(1) in EXT: d[ci[it]][it.test].add(mm.group(1))
ar=defaultdict(set)
for e in g.edges:
    if e[6] is None or isinstance(e[7],graph.Module): continue
    a,b=ci[e[6]],ci[e[7]]
    if a!=b and not a.startswith('tests') and not b.startswith('tests'): ar[(a,e[2])].add(b)
with open('ext.md','w') as o:
    for c in ORDER:
        print('| %s | %s | %s | %s | %s |'%(c,' '.join(x for x in ORDER if x in ar[(c,False)] and x in ALLOWED.get(c,())),' '.join(sorted(d[c][False])),' '.join(sorted(d[c][True]-d[c][False])),' '.join(x for x in ORDER if x in ar[(c,True)]-ar[(c,False)] and x!=c)),file=o)
