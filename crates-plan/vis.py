import sys; sys.path.insert(0,'.')
from plan import *; import plan
from moves import MOVES
def members(it):
    """[(name, vis, line)] of restricted members inside a struct or an impl."""
    t=it.toks; out=[]
    for i,x in enumerate(t):
        if x.v=='pub' and x.k=='id' and i+1<len(t) and t[i+1].v=='(' and i>0:
            j=i+1
            while t[j].v!=')': j+=1
            vis='pub'+''.join(y.v for y in t[i+1:j+1]); j+=1
            while t[j].v in('const','async','unsafe','fn'): j+=1
            if t[j].k=='id': out.append((t[j].v,vis,t[j].line))
    return out
def run(root):
    g=load(root); ci=crate_of_items(g,MOVES)
    need=defaultdict(lambda:defaultdict(set))
    for e in g.edges:
        f,line,test,tf,name,kind,src,dst,info=e
        if src is None or isinstance(dst,graph.Module): continue
        a,b=ci[src],ci[dst]
        if a==b or b.startswith('tests'): continue
        if dst.vis!='pub' and dst.kind not in('impl',) : need[b][(dst.file,dst.line,dst.kind,dst.name,dst.vis or 'private',dst.test)].add((a,f,line,test))
    # names used behind a dot or :: in each crate
    used=defaultdict(lambda:defaultdict(set))
    for it in g.items:
        t=it.toks
        for i,x in enumerate(t):
            if x.k=='id' and i>0 and (t[i-1].v=='.' or t[i-1].k=='cc' or (i+1<len(t) and t[i+1].v in(':',',','}') )): used[x.v][ci[it]].add((it.file,x.line,it.test))
    # which types of a crate are named, or may be met, outside
    mem=defaultdict(list)
    for it in g.items:
        if it.kind in('struct','impl'):
            b=ci[it]
            if b.startswith('tests') : continue
            for n,v,l in members(it):
                us={a:u for a,u in used[n].items() if a!=b and b in ALLOWED.get(a,set()) and not a.startswith('tests')}
                # the file that uses it must reach the type's file or name something of that crate
                if us: mem[b].append((it.file,l,it.name,n,v,{a:sorted(u)[:3] for a,u in us.items()}, it.test))
    return g,ci,need,mem
if __name__=='__main__':
    g,ci,need,mem=run(sys.argv[1])
    for b in ORDER:
        if need[b]:
            print('##',b,'items',len([k for k in need[b] if not k[5]]),'test items',len([k for k in need[b] if k[5]]))
            for k in sorted(need[b]): print('   ',k,len(need[b][k]),sorted({x[0] for x in need[b][k]}))
    for b in ORDER:
        if mem[b]:
            print('##',b,'members',len(mem[b]))
            for m in sorted(mem[b],key=str): print('   ',m[:5],{a:[x[0]+':'+str(x[1]) for x in u] for a,u in m[5].items()})
