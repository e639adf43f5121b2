// Work-items that the calling thread and waiting worker threads of a CPU share (TEAM, a build option; host/team.py).
//
// Waking a worker thread takes longer than a short launch. In a launch by a team, workers have been started before it and
// wait in the kernel: they are its members. The calling thread runs the kernel as the leader. All take work-items from one
// counter until none is left. The leader then waits until all are done; members wait for the next launch, and end when
// none comes in `poll_limit` polls, or when the host dismisses them. A leader without members does all work.
//
// Kernels that a team can run have TEAM_ARGUMENTS as their last arguments, and their work in FOR_EACH_ITEM(item) { ... },
// which without TEAM runs once, for this work-item. `item` has the places of the work-item in two dimensions (uint2).
// ITEM_COLUMNS is the global size in the first dimension.
#ifndef TEAM_H
#define TEAM_H

#ifdef TEAM
// Each counter that several threads change has its own cache line (64 bytes). host/team.py has the same offsets.
typedef struct {
    uint items, columns;  // work-items of the launch; of them in the first dimension
    uint core, members;  // core of the calling thread (NO_CORE: not known) when the members were started; their number
    uint unused[12];
    uint taken;  // work-items that somebody has begun; not below `items` between launches
    uint apart[15];
    uint done;  // work-items that are complete
    uint more_apart[15];
    uint ended;      // members that have ended since the host started them
    uint dismissed;  // not 0: members end as soon as no work is left
    uint begun;      // members that have begun
    uint rest[13];
} Team;

#define TEAM_ARGUMENTS , global Team *team, const uint poll_limit
#define ITEM_COLUMNS team->columns
#define FOR_EACH_ITEM(item) \
    for (uint2 item = first_item(team, poll_limit); item.y != NO_ITEM; item = next_item(team, poll_limit))
#define NO_ITEM 0xffffffffu
#define NO_CORE 0xffffffffu
#define LEADER 0  // `poll_limit` of the calling thread

// Tell the processor that this thread waits in a loop: a thread on the same core gets more of it.
#if __has_builtin(__builtin_ia32_pause)
#define PAUSE() __builtin_ia32_pause()
#else
#define PAUSE()
#endif

static inline uint load_counter(global uint *counter) { return __atomic_load_n(counter, __ATOMIC_ACQUIRE); }

// Take the next work-item; without one the result has y = NO_ITEM.
static inline uint2 take_item(global Team *team) {
    const uint number = __atomic_fetch_add(&team->taken, 1, __ATOMIC_ACQ_REL);
    return number < team->items ? (uint2)(number % team->columns, number / team->columns) : (uint2)NO_ITEM;
}

// Core of this thread.
static inline uint core_number(void) {
#if __has_builtin(__builtin_ia32_rdtscp)
    uint number;
    __builtin_ia32_rdtscp(&number);
    return number & 0xfff;
#else
    return NO_CORE;
#endif
}

// Begin as a member. A member on the core of the calling thread would be in its way: return false for it, after all others
// have begun, because a worker that ends takes the next work-item, and so the place of another worker.
static inline int joins(global Team *team, uint poll_limit) {
    __atomic_fetch_add(&team->begun, 1, __ATOMIC_ACQ_REL);
    if (team->core == NO_CORE || core_number() != team->core) return 1;
    for (uint poll = 0; poll < poll_limit && load_counter(&team->begun) < team->members; poll++) PAUSE();
    return 0;
}

// Wait as a member for a work-item of this launch or of the next one.
static inline uint2 wait_for_item(global Team *team, uint poll_limit) {
    for (uint poll = 0; poll < poll_limit && !load_counter(&team->dismissed); poll++) {
        if (load_counter(&team->taken) < team->items) {
            const uint2 item = take_item(team);
            if (item.y != NO_ITEM) return item;
        }
        PAUSE();
    }
    __atomic_fetch_add(&team->ended, 1, __ATOMIC_ACQ_REL);
    return (uint2)NO_ITEM;
}

static inline uint2 first_item(global Team *team, uint poll_limit) {
    if (poll_limit != LEADER) return wait_for_item(team, joins(team, poll_limit) ? poll_limit : 0);
    __atomic_store_n(&team->done, 0, __ATOMIC_RELAXED);
    __atomic_store_n(&team->taken, 0, __ATOMIC_RELEASE);  // from here on members take work-items
    return take_item(team);
}

static inline uint2 next_item(global Team *team, uint poll_limit) {
    __atomic_fetch_add(&team->done, 1, __ATOMIC_ACQ_REL);
    if (poll_limit != LEADER) return wait_for_item(team, poll_limit);
    const uint2 item = take_item(team);
    while (item.y == NO_ITEM && load_counter(&team->done) < team->items) PAUSE();
    return item;
}
#else
#define TEAM_ARGUMENTS
#define ITEM_COLUMNS get_global_size(0)
#define FOR_EACH_ITEM(item) const uint2 item = (uint2)(get_global_id(0), get_global_id(1));
#endif

#endif
