// A signature of KUKA's API, for the compiler alone.
package javax.inject;

@java.lang.annotation.Retention(java.lang.annotation.RetentionPolicy.RUNTIME)
public @interface Inject {
}
