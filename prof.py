import sys; sys.argv=['x','--steps','0']; exec(open('/work/runs/learn18/lab_space.py').read())
for b,bf,k in ((16,0,1),(8,1,1),(8,0,1),(8,1,2)):
    m=Space(32,4,k,o.sfg,o.sbg,o.sstd,16,32,4,4,16,16,16)
    def st():
        v=as_float(ti[:b])
        with torch.autocast('cpu',torch.bfloat16,enabled=bool(bf)): sc=m(v,Context({q:torch.tensor(float(x)) for q,x in sch.items()},Noise()))
        sum(t.mean() for t in sc.terms.values()).backward()
    st(); t=time.process_time(); st(); st(); st(); print(b,bf,k,(time.process_time()-t)/3,flush=True)
    if b==8:
        from torch.profiler import profile
        with profile() as p: st()
        print(p.key_averages().table(sort_by='self_cpu_time_total',row_limit=9,max_name_column_width=30).split('Self CPU time')[0][:2600])
