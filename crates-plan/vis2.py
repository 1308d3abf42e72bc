import sys; sys.path.insert(0,'.')
from vis import *
def run2(root):
    g,ci,need,mem=run(root)
    link=defaultdict(set)
    for e in g.edges:
        if not isinstance(e[7],graph.Module): link[e[0]].add(e[3])
    out=defaultdict(list)
    for it in g.items:
        if it.kind not in('struct','impl') or ci[it].startswith('tests'): continue
        ms=members(it)
        # private members as well
        t=it.toks
        if it.kind=='struct':
            b=[i for i,x in enumerate(t) if x.v=='{']
            if b:
                i=b[0]+1; depth=0
                while i<len(t)-1:
                    if t[i].v in '([{<' and t[i].k=='p': depth+=1
                    elif t[i].v in ')]}>' and t[i].k=='p': depth-=1
                    elif depth==0 and t[i].k=='id' and t[i+1].v==':' and t[i-1].v!='pub' and not(t[i-1].v==')' ) and t[i-1].v in(',','{',']'): ms.append((t[i].v,'private',t[i].line))
                    i+=1
        else:
            depth=0
            for i,x in enumerate(t):
                if x.v=='{': depth+=1
                elif x.v=='}': depth-=1
                elif x.v=='fn' and x.k=='id' and depth==1 and not it.trait:
                    j=i-1
                    while t[j].v in('const','async','unsafe'): j-=1
                    if t[j].v!='pub' and t[j].v!=')' : ms.append((t[i+1].v,'private',x.line))
                    elif t[j].v==')' :
                        k=j
                        while t[k].v!='(' : k-=1
                        if t[k-1].v!='pub': ms.append((t[i+1].v,'private',x.line))
        for n,v,l in ms:
            m=it.mod
            scope={'pub(crate)':(), 'private':m.path}.get(v, m.path[:-1])
            r=re.match(r'pub\(incrate(.*)\)',v)
            if r: scope=tuple(x for x in r.group(1).split('::') if x)
            uses=set()
            for it2 in g.items:
                if it2.mod.crate!=m.crate or it2.mod.path[:len(scope)]!=scope or ci[it2]==ci[it] : continue
                if it2.file not in g.files or (it.file not in link[it2.file] and it2.file!=it.file): continue
                tt=it2.toks
                for i,x in enumerate(tt):
                    if x.k=='id' and x.v==n and i>0 and (tt[i-1].v=='.' or tt[i-1].k=='cc' or (i+1<len(tt) and tt[i+1].v==':' )): uses.add((ci[it2],it2.file,x.line,it2.test))
            if uses: out[ci[it]].append((it.file,l,it.name,n,v,sorted(uses)[:3],len(uses)))
    return g,ci,need,out
if __name__=='__main__':
    g,ci,need,out=run2(sys.argv[1])
    for b in ORDER:
        for m in out[b]: print(b,m)
