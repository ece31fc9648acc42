/* @NAME@ as a functional mock-up unit: FMI 3.0, co-simulation. Written by hybridkin @VERSION@.

   Compile this file alone, as a shared library; it includes @NAME@.c. */
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "@NAME@.c"

#if defined(_WIN32)
#define FMI __declspec(dllexport)
#elif defined(__GNUC__)
#define FMI __attribute__((visibility("default")))
#else
#define FMI
#endif

enum { FMI_OK = 0, FMI_ERROR = 3 }; /* of fmi3Status */

/* Where a variable begins among the values of an instance, in the order of modelDescription.xml. */
enum { @OFFSETS@ };

/* By value reference, from 1 on; the time has 0. */
static const struct {
    int begin, size, may_be_set;
} variables[] = {{0, 0, 0}, @VARIABLES@};

enum { VARIABLES = sizeof variables / sizeof *variables };

static const double start_values[VALUES] = {@STARTS_OF_VALUES@};

typedef struct {
    double values[VALUES], time;
    int running; /* initialised */
    @INSTANCE@
} instance_t;

@UPDATE@

static int read_or_write(instance_t *unit, const uint32_t references[], size_t n_references,
                         double values[], size_t n_values, int writes) {
    for (size_t k = 0; k < n_references; k++) {
        const uint32_t r = references[k];
        if (r >= VARIABLES || (writes && !variables[r].may_be_set)) return FMI_ERROR;
        const size_t size = r ? (size_t)variables[r].size : 1;
        double *place = r ? unit->values + variables[r].begin : &unit->time;
        if (size > n_values) return FMI_ERROR;
        if (writes)
            memcpy(place, values, size * sizeof *values);
        else
            memcpy(values, place, size * sizeof *values);
        values += size;
        n_values -= size;
    }
    return n_values ? FMI_ERROR : FMI_OK;
}

FMI const char *fmi3GetVersion(void) { return "3.0"; }

FMI int fmi3SetDebugLogging(void *unit, bool on, size_t n, const char *const categories[]) {
    (void)unit, (void)on, (void)n, (void)categories;
    return FMI_OK;
}

FMI int fmi3Reset(void *unit) {
    instance_t *all = unit;
    memset(all, 0, sizeof *all);
    memcpy(all->values, start_values, sizeof start_values);
    return FMI_OK;
}

FMI void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                      bool visible, bool logging, bool events, bool early,
                                      const uint32_t between[], size_t n_between,
                                      void *environment, void *log, void *update) {
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
    (void)between, (void)n_between, (void)environment, (void)log, (void)update;
    if (!token || strcmp(token, "@TOKEN@")) return NULL; /* of another modelDescription.xml */
    instance_t *unit = malloc(sizeof *unit);
    if (unit) fmi3Reset(unit);
    return unit;
}

FMI void fmi3FreeInstance(void *unit) { free(unit); }

FMI int fmi3EnterInitializationMode(void *unit, bool tolerance_defined, double tolerance,
                                    double start, bool stop_defined, double stop) {
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop;
    ((instance_t *)unit)->time = start;
    return FMI_OK;
}

FMI int fmi3ExitInitializationMode(void *unit) {
    start_unit(unit);
    ((instance_t *)unit)->running = 1;
    return FMI_OK;
}

FMI int fmi3EnterStepMode(void *unit) {
    (void)unit;
    return FMI_OK;
}

FMI int fmi3Terminate(void *unit) {
    (void)unit;
    return FMI_OK;
}

FMI int fmi3GetFloat64(void *unit, const uint32_t references[], size_t n_references,
                       double values[], size_t n_values) {
    instance_t *all = unit;
    if (!all->running) start_unit(all); /* what depends on the start values so far */
    return read_or_write(all, references, n_references, values, n_values, 0);
}

FMI int fmi3SetFloat64(void *unit, const uint32_t references[], size_t n_references,
                       const double values[], size_t n_values) {
    return read_or_write(unit, references, n_references, (double *)values, n_values, 1);
}

FMI int fmi3DoStep(void *unit, double time, double step, bool no_return, bool *event,
                   bool *terminate, bool *early, double *last) {
    instance_t *all = unit;
    (void)no_return;
    *event = *terminate = *early = false;
    const int status = step_unit(all, step);
    all->time = *last = time + (status == FMI_OK ? step : 0.0);
    return status;
}

FMI int fmi3GetFMUState(void *unit, void **state) {
    if (!*state) *state = malloc(sizeof(instance_t));
    if (!*state) return FMI_ERROR;
    memcpy(*state, unit, sizeof(instance_t));
    return FMI_OK;
}

FMI int fmi3SetFMUState(void *unit, void *state) {
    memcpy(unit, state, sizeof(instance_t));
    return FMI_OK;
}

FMI int fmi3FreeFMUState(void *unit, void **state) {
    (void)unit;
    free(*state);
    *state = NULL;
    return FMI_OK;
}

/* Types and modes that this unit does not have. */
#define NO_TYPE(type, of)                                                                        \
    FMI int fmi3Get##type(void *i, const uint32_t r[], size_t n, of v[], size_t m) {             \
        (void)i, (void)r, (void)v;                                                               \
        return n || m ? FMI_ERROR : FMI_OK;                                                      \
    }                                                                                            \
    FMI int fmi3Set##type(void *i, const uint32_t r[], size_t n, const of v[], size_t m) {       \
        (void)i, (void)r, (void)v;                                                               \
        return n || m ? FMI_ERROR : FMI_OK;                                                      \
    }
NO_TYPE(Float32, float)
NO_TYPE(Int8, int8_t)
NO_TYPE(UInt8, uint8_t)
NO_TYPE(Int16, int16_t)
NO_TYPE(UInt16, uint16_t)
NO_TYPE(Int32, int32_t)
NO_TYPE(UInt32, uint32_t)
NO_TYPE(Int64, int64_t)
NO_TYPE(UInt64, uint64_t)
NO_TYPE(Boolean, bool)
NO_TYPE(String, char *)

#define REFUSED(function)                                                                        \
    FMI int function(void) { return FMI_ERROR; }
REFUSED(fmi3EnterEventMode)
REFUSED(fmi3GetBinary)
REFUSED(fmi3GetClock)
REFUSED(fmi3SetBinary)
REFUSED(fmi3SetClock)
REFUSED(fmi3GetNumberOfVariableDependencies)
REFUSED(fmi3GetVariableDependencies)
REFUSED(fmi3SerializedFMUStateSize)
REFUSED(fmi3SerializeFMUState)
REFUSED(fmi3DeserializeFMUState)
REFUSED(fmi3GetDirectionalDerivative)
REFUSED(fmi3GetAdjointDerivative)
REFUSED(fmi3EnterConfigurationMode)
REFUSED(fmi3ExitConfigurationMode)
REFUSED(fmi3GetIntervalDecimal)
REFUSED(fmi3GetIntervalFraction)
REFUSED(fmi3GetShiftDecimal)
REFUSED(fmi3GetShiftFraction)
REFUSED(fmi3SetIntervalDecimal)
REFUSED(fmi3SetIntervalFraction)
REFUSED(fmi3SetShiftDecimal)
REFUSED(fmi3SetShiftFraction)
REFUSED(fmi3EvaluateDiscreteStates)
REFUSED(fmi3UpdateDiscreteStates)
REFUSED(fmi3EnterContinuousTimeMode)
REFUSED(fmi3CompletedIntegratorStep)
REFUSED(fmi3SetTime)
REFUSED(fmi3SetContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives)
REFUSED(fmi3GetEventIndicators)
REFUSED(fmi3GetContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates)
REFUSED(fmi3GetOutputDerivatives)
REFUSED(fmi3ActivateModelPartition)
FMI void *fmi3InstantiateModelExchange(void) { return NULL; }
FMI void *fmi3InstantiateScheduledExecution(void) { return NULL; }
